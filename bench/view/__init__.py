"""Looking at models and scenes in a browser: a server on this machine's own address, and its page."""
