"""Offline work on whole recordings: analyze, compare with truth, report."""
