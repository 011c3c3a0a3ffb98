"""The batch of test plants of Astrom and Hagglund, tuned by estune and by rules."""
