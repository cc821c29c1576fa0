"""Readers and writers of data sets, and everything else that touches files."""
