"""Public robot files as Muster loads them, beside MuJoCo's own reading: ``python -m benchmarks.robots`` writes ``robots.md``.

For each file: (a) the greatest relative difference of a compared value of the model, (b) the greatest difference of a coordinate after
one second in MuJoCo's C engine with the file's own integrator, without contacts, under fixed controls, (c) the same of Muster's own
step on the CPU.
"""
