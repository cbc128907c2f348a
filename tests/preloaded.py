"""Imported by the fork server: loads numba's compiled code, so that forked estimators need not."""

from services.estimator.factory import EstimatorOptions, prepare_factory

for model in ("learned", "exact"):
    prepare_factory(EstimatorOptions(model=model))
