"""Making of the figures of :mod:`reports.plots`, by kind."""
