"""Programs around HAC's own, which import nothing of this project."""
