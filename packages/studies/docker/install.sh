#!/usr/bin/env bash
# Install guiderail with its siblings for the benchmark into a virtual environment: install.sh CHECKOUT ENVIRONMENT
set -euo pipefail
checkout=$(cd "${1:?usage: install.sh CHECKOUT ENVIRONMENT}" && pwd)
environment=${2:?usage: install.sh CHECKOUT ENVIRONMENT}
# Drake needs GLib and X11, and cameras render with EGL: packages of the operating system.
libraries=$(ldconfig -p)
for library in libEGL.so.1 libglib-2.0.so.0 libX11.so.6; do
  if [[ $libraries != *$library* ]] && [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    apt-get update -qq && apt-get install -qq -y --no-install-recommends libegl1 libgl1 libglib2.0-0 libx11-6
    break
  fi
done
"${PYTHON:-python3}" -m venv "$environment"
"$environment/bin/pip" install --quiet --constraint "$checkout/constraints.txt" \
  "$checkout[learn]" "$checkout/packages/studies" "$checkout/packages/parts" "$checkout/packages/data[minari]" \
  "$checkout/packages/hardware"
"$environment/bin/python" -c "import guiderail_studies.benchmark.submission"  # Drake and all that the commands import
echo "installed: $environment/bin/guiderail"
