"""Where the robot can be: workspace, singularities, the mechanism's outline, and pictures of them."""
