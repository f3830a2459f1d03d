"""Many runs: summary over seeds, jobs from a list, searches that see no target label."""
