"""What all estimators use."""
