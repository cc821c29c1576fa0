"""Write simulated drives in the layouts of the data sets, so that readers can be tested and drives cached.

A log appears under its name when all of it is on disk. If a writer fails, an earlier log of that name stays.
"""
