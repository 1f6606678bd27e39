"""Stage one: sample parameter sets, run trials, fit and validate the error model."""
