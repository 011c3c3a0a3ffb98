"""The force that a reel exerts while the far end of its cable moves, by a sensor outside."""
