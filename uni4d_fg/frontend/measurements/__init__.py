"""Measurements that other sensors made of the camera, from files, per frame of a sequence."""
