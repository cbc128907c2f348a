"""The estimator interface and the generative models, shared by all estimators."""
