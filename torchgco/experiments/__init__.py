"""Studies, from configurations to tables: the floor above everything else."""
