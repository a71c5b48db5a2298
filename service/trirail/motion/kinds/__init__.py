"""Planning of each kind of goal, one file per kind; goal_planner imports all of them."""
