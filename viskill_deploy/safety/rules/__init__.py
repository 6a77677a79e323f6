"""One rule a file. Every rule in this folder is always on: there is no list to leave one out of.

A rule's module holds one class `Rule` with the shape of `base.Rule`.
"""
