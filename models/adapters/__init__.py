"""Grasp generators that are not our own network, behind the contract `models.types.GraspGenerator`."""
