# docker build -t mimopilot . && docker run --rm -v "$PWD:/work" mimopilot tune flight.ulg --out my.gains.toml
FROM debian:trixie-slim AS build
# Not pinned: Debian's mirrors hold only the newest version of a package of a stable release.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN python3 -m venv /opt/mimopilot \
    && /opt/mimopilot/bin/pip install --no-cache-dir --no-compile "/source[vehicle,report,emulator,campaign]"

FROM debian:trixie-slim
# The C++ compiler is needed at run time: gains are flown and tested as compiled code.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 g++ make gcc-arm-none-eabi libnewlib-arm-none-eabi \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 pilot \
    && install --directory --owner=pilot /work
COPY --from=build /opt/mimopilot /opt/mimopilot
ENV PATH=/opt/mimopilot/bin:$PATH
USER 1000
WORKDIR /work
ENTRYPOINT ["mimopilot"]
CMD ["--help"]
