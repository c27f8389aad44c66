"""Studies, from configurations to tables: the top layer of the library."""
