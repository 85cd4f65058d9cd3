"""Drives read from files of many kinds, and a made-up one."""
