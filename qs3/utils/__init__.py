"""Parts that any program needs: atomic files, locks, processes, progress, text tables, figures, seeds."""
