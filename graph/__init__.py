"""Retracer's runtime: a dataflow of operator processes that can be retraced to the bit."""

from graph.contract import End, Operator, Sink, Source, Summary

__all__ = ["End", "Operator", "Sink", "Source", "Summary"]
