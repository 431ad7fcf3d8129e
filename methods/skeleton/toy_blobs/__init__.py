"""The method toy-blobs of econgs-bench. The harness reads ``spec.py``; nothing is imported here."""
