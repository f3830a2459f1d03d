"""The behaviour of the authors' released code (QS3, 2022), where qs3 does better by default.

`released=yes` brings all of it back, part by part (conf/released); docs/reference/released.md says
what the parts are. `poses=PATH` takes the very poses that the authors published.
"""
