"""Motion planning: computation of paths that lead to goals and stay within all limits."""
