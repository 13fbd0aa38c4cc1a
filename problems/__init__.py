"""One system each: the question it answers, its problem, the closed form, a simulator and plots."""
