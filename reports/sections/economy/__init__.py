"""What a quality costs."""
