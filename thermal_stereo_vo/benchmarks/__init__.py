"""Measurements that drive whole pipelines: times, growth, gaps, and the counterpart of Table V."""
