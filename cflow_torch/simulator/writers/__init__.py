"""Write simulated drives in the layouts of the data sets, so that readers can be tested and drives cached.

A log appears under its name only when it is complete. If a writer fails, an existing log of that name stays.
"""
