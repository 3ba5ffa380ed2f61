"""One file for each architecture that `encoders.py` and `segmenters.py` can load."""
