# sattools on the CPU:  docker build -t sattools .   then   docker run --rm -v "$PWD":/data sattools --help
FROM python:3.12-slim
COPY pyproject.toml README.md LICENSE install.sh /opt/sattools/
COPY sattools /opt/sattools/sattools
RUN bash /opt/sattools/install.sh products,batch,notebook && sattools doctor --slim
WORKDIR /data
ENTRYPOINT ["sattools"]
