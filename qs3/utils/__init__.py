"""Parts that any program needs: files, locks, processes, progress, tables, figures, seeds."""
