"""trirail: a background service that drives a 3-PRP planar parallel robot in real time."""

from importlib.metadata import version

__version__ = version("trirail")
