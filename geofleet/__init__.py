"""Turn the traffic-sign detections of many cars into an updated sign map, and say how good it is."""
