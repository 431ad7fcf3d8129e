"""The questions of a report: a folder each, with its table, conclusion, chart and section."""
