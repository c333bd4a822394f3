#!/bin/sh
# Print the Python that the virtual environment is made from: with ROS sourced, the python3 that imports rclpy; else
# the best one that runs. A name on PATH proves nothing (pyenv's shims fail unless selected), so every one is tried.
works() { "$1" -c 'import sys, venv, ensurepip; raise SystemExit(not sys.version_info >= (3, 11))' >/dev/null 2>&1; }
if [ -z "$PYTHON" ] && python3 -c 'import rclpy' >/dev/null 2>&1; then PYTHON=python3; fi
pyenv_root=$(pyenv root 2>/dev/null || echo "${PYENV_ROOT:-$HOME/.pyenv}")
for candidate in $PYTHON python3.12 "$pyenv_root"/versions/3.12*/bin/python3.12 \
    python3.13 "$pyenv_root"/versions/3.13*/bin/python3.13 python3.11 "$pyenv_root"/versions/3.11*/bin/python3.11 python3
do
    if works "$candidate"; then
        "$candidate" -c 'import sys; print(sys.executable)'
        exit 0
    fi
done
echo "setup: no Python 3.11 or newer with venv found; install python3.12 and python3.12-venv, or set PYTHON=/path" >&2
exit 1
