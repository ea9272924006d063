#!/usr/bin/env bash
# Install guiderail with its siblings for the benchmark into a virtual environment: install.sh CHECKOUT ENVIRONMENT
set -euo pipefail
checkout=$(cd "${1:?usage: install.sh CHECKOUT ENVIRONMENT}" && pwd)
environment=${2:?usage: install.sh CHECKOUT ENVIRONMENT}
# Cameras render with EGL, a package of the operating system.
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null && ! ldconfig -p | grep -q libEGL.so.1; then
  apt-get update -qq && apt-get install -qq -y --no-install-recommends libegl1 libgl1 libx11-6
fi
"${PYTHON:-python3}" -m venv "$environment"
"$environment/bin/pip" install --quiet --constraint "$checkout/constraints.txt" \
  "$checkout[learn]" "$checkout/packages/studies" "$checkout/packages/parts" "$checkout/packages/data[minari]" \
  "$checkout/packages/hardware"
"$environment/bin/guiderail" benchmark run --help >/dev/null
echo "installed: $environment/bin/guiderail"
