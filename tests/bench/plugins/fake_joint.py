"""The same, for several scenes at once."""

from fake import _spec

SPEC = _spec("fake-joint", joint=True)
