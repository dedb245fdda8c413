"""One file per pass; the order lives in :mod:`loihi1.compilation`."""
