"""Parts that any program needs: atomic files, locks, processes, progress bars, seeds, text."""
