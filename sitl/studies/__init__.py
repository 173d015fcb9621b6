"""Whole experiments that use every room; nothing but the front door imports them."""
