"""A toy method for econgs-bench: round Gaussians that stay where the cloud put them."""
