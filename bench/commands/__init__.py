"""The commands of ``bench``, a module each for those that belong together."""
