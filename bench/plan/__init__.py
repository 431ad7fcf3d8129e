"""From a suite and a selection to the graph of jobs."""
