"""Area survey: which scans cover an area, in which order, and how does the satellite turn from one to the next?"""
