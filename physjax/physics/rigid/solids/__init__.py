"""Solids: bodies that may not pass each other, in the plane and in space.

`contact` is what a scene is given. `pairs` puts contacts into groups, `world` is what does not change in a step, `response`
is a step in sub-steps: `impacts` lets bodies bounce, and `sweeps` of impulses hold them apart. What differs between the
plane and space is a `Mechanics`, one in `rigid.planar` and one in `rigid.space`.
"""
