"""Pictures by number of training views."""
