"""Planning of each kind of goal, with one module per kind. goal_planner imports all of them."""
