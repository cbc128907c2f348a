"""How often an estimator is wrong about its own pose, in worlds that nobody tuned on."""
