# The runtime, from a wheel in dist/ (make wheel): docker build -t splatctrl . && docker run -v "$PWD:/work" splatctrl demo
FROM python:3.11-slim AS install
COPY constraints.txt dist/*cp311*.whl /tmp/
RUN python -m venv --without-pip /opt/splatctrl \
 && pip --python /opt/splatctrl/bin/python install --no-cache-dir --only-binary=:all: -c /tmp/constraints.txt /tmp/*.whl \
 && rm -r /opt/splatctrl/lib/python3.11/site-packages/cmeel.prefix/include

FROM python:3.11-slim
COPY --from=install /opt/splatctrl /opt/splatctrl
ENV PATH=/opt/splatctrl/bin:$PATH
WORKDIR /work
ENTRYPOINT ["splatctrl"]
