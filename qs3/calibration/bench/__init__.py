"""Known targets before any depth sensor: are its errors those of the device it stands for?

    qs3 bench sensor=kinect_v1,realsense_d435

renders planes, an edge and a table with the sensor's own settings, measures what comes back as
depth-quality tools do, and writes tables, figures and a page.
"""
