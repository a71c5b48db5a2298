"""Planning of goals, with one module per kind of goal. goal_planner imports all modules of this package."""
