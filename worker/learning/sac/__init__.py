"""Soft actor-critic for thousands of worlds on the device: replay, critics and updates made for graphs and gangs."""
