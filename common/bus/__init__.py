"""Communication over zenoh; the only package of the services that imports it, apart from the ROS 2 bridge."""
