"""Pictures of scenes: panels, differences, contact sheets, transfer functions."""
