"""Planning at test time: the policy as prior, the engine as model, plans executed in closed loop.

problems      levels and the states from which actions are searched, many copies of each
proposals     sequences of actions to try: held for random durations, variants of the nearest
policy_round, held_round, explore_round    one program each: a batch of episodes for all problems
ranking       share of slightly different starts that a solution solves
planner       rounds one after the other until each problem has a plan or no time
execution     plans in the environment: compared with what was planned, replanned where that deviates
search_rates  solve rates of it, against seconds and from perturbed starts
"""
