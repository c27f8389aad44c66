"""Long studies, kills, wrong input: what the library bears."""
