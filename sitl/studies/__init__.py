"""Whole experiments that use all packages; only the command line imports them."""
