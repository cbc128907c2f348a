"""`presage bench accuracy` and `bench speed`: estimators and the bound, side by side."""
