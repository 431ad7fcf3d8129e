"""Making of the figures of :mod:`reports.charts.plots`, by kind."""
