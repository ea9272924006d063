"""Gymnasium environments: configuration, assembly of the diagram, observation, trace and views."""
