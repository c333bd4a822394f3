"""Hypotheses drawn and scored in one kernel: on a GPU by Pallas and Triton, on a CPU by loops that numba compiles.

One interface, `gain(drawn, scenes, image, library, noise, window)`, chosen by backend (`choice.py`). The reference of
both are whole images (`scene_score.log_likelihood_scene`).
"""
