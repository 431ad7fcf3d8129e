"""Methods of commands for the code of other authors, as plugin folders: ``--plugins FOLDER``."""
