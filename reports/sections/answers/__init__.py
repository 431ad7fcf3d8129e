"""Which method is best at what: the first screen of the page."""
