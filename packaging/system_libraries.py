"""Check for the shared libraries the wheels expect from the system; install them when root on Debian.

Run by `make demo` and `make test` with any Python; uses the standard library only.
"""

import ctypes.util
import os
import shutil
import subprocess
import sys

# library name as the loader knows it -> Debian package that carries it
NEEDED = {"EGL": "libegl1", "GL": "libgl1", "usb-1.0": "libusb-1.0-0", "gomp": "libgomp1", "X11": "libx11-6"}
# Mesa's software driver has no library that find_library sees: look for the driver folder's file.
DRI_PACKAGE = "libgl1-mesa-dri"
XVFB_PACKAGE = "xvfb"
# Exported pages are tested in a browser, by any of these names.
BROWSERS, BROWSER_PACKAGE = ("chromium", "chromium-browser", "google-chrome"), "chromium"


def missing_packages() -> list[str]:
    """Debian packages of the libraries that the loader cannot find."""
    missing = [package for name, package in NEEDED.items() if ctypes.util.find_library(name) is None]
    has_vendor = any(
        os.path.isdir(folder) and os.listdir(folder)
        for folder in ("/usr/share/glvnd/egl_vendor.d", "/etc/glvnd/egl_vendor.d")
    )
    if not has_vendor:
        missing.append("libegl-mesa0")
        missing.append(DRI_PACKAGE)
    if shutil.which("Xvfb") is None and not os.environ.get("DISPLAY"):
        missing.append(XVFB_PACKAGE)  # window tests; the headless path does not need it
    return missing


def main() -> int:
    """Install what is missing, or print the line that does; 0 unless an install failed.

    With --tests also a browser; its tests are skipped where it cannot be had.
    """
    if not sys.platform.startswith("linux"):
        return 0
    code = install(missing_packages())
    if "--tests" in sys.argv[1:] and not any(map(shutil.which, BROWSERS)):
        install([BROWSER_PACKAGE])
    return code


def install(missing: list[str]) -> int:
    """Install Debian packages, or print the line that does; apt's exit code."""
    if not missing:
        return 0
    command = ["apt-get", "install", "-y", "--no-install-recommends", *missing]
    if os.geteuid() != 0 or shutil.which("apt-get") is None:
        print("System packages are missing. Please run:\n  sudo " + " ".join(command))
        return 0
    print("Installing system packages: " + " ".join(missing))
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    subprocess.run(["apt-get", "update", "-q"], env=environment, capture_output=True, check=False)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        print(done.stderr, file=sys.stderr, end="")
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
