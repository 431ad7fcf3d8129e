"""Drawing of the figures of :mod:`reports.charts`, by kind."""
