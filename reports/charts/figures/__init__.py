"""Drawing of the figures of :mod:`reports.charts.files`, by kind."""
