"""One file for each method: a short list of calls to stages."""
