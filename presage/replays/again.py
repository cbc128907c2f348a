"""`presage replay FILE --with estimator`: started from the file alone, heard again, compared."""
