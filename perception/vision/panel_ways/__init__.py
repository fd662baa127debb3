"""Ways to find the panel in one image without switched lights: by printed tags, by its outline, or by its objects.

Each way measures known points of the panel in the image with covariances (`corners`), and `points` computes the pose,
its covariance and its mirror poses from them. The result of every way is a `PanelSighting`.
"""
