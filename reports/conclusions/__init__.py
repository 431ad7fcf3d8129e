"""What a report's tables say about the methods: which is best at what, by how much, and if significantly."""
