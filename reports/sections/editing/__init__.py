"""Quality after edits."""
