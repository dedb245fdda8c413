"""One file per pass; the order lives in :mod:`compiler.pipeline`."""
