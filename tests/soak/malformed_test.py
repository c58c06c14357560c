"""Hostile files, each read by a process of its own, whose memory and time are limited.

`tests/malformed_test.py` tries these and much more in its own process.
"""
