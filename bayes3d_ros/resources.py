# SPDX-License-Identifier: Apache-2.0

"""Files that come with the package: bundled bags, parameters, profiles."""

from pathlib import Path


def share_directory() -> Path:
    """The folder that holds `bags`, `config` and `launch`: the checkout, or share/bayes3d_ros where it is installed.

    Found from this file, because ament's index needs AMENT_PREFIX_PATH, which only a sourced ROS sets. Raises
    FileNotFoundError.
    """
    here = Path(__file__).resolve()
    checkout = here.parents[1]
    installed = [parent / "share" / "bayes3d_ros" for parent in here.parents]  # PREFIX/lib/pythonX/site-packages/...
    for folder in (checkout, *installed):
        if (folder / "package.xml").is_file() and (folder / "config").is_dir():
            return folder
    raise FileNotFoundError(f"share/bayes3d_ros not found above {here}")
