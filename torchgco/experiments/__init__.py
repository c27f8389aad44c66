"""Studies and missions from configs to tables: the floor above everything else."""
