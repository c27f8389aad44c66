"""Reports on finished studies, and their verification."""
