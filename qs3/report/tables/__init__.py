"""Tables of runs: cells, statistics, formats, paired comparisons."""
