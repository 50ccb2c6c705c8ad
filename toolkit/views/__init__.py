"""Which views to use: selection by the spread of their directions, and baselines to compare with."""
