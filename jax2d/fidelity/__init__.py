"""How true the engine is: motions with a formula, scenes on which solvers fail, and what accuracy costs in time."""
