# docker build -t uni4d-fg . && docker run --rm uni4d-fg            (the demo)
# docker run --rm -v "$PWD:/work" uni4d-fg reconstruct clip.mp4 --out runs/clip
FROM python:3.12-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends build-essential && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY . .
RUN packaging/build_wheels.sh /wheels

FROM python:3.12-slim-bookworm
RUN apt-get update && apt-get install -y --no-install-recommends libusb-1.0-0 libgl1 libgomp1 && rm -rf /var/lib/apt/lists/*
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir /wheels/uni4d_fg_cpp-*.whl "$(ls /wheels/uni4d_fg-*.whl)[cues,view,export]" && rm -rf /wheels
WORKDIR /work
ENTRYPOINT ["uni4d-fg"]
CMD ["demo"]
