"""What filters are made of: sigma points, transforms, noise, triangular factors, and the solution of an update.

Nothing here knows a filter, a model or a manifold.
"""
