"""How often an estimator reports a wrong pose as right, in generated buildings and real logs."""
