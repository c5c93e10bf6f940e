"""Results become files and pictures; all are observers."""
