"""Certificates: proven bounds on the commands of a movement primitive for all policies, with an independent checker."""
