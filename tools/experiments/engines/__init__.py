"""What runs the jobs of a study, one file each."""
