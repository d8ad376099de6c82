# JupyterLab with the notebooks, for anybody who has Docker and nothing else:
#     docker build -t ditr_lite .
#     docker run --rm -p 127.0.0.1:8888:8888 ditr_lite          (then open the address with the token that it prints)
# The light set by default; --build-arg SET=environment.txt installs everything. About 1.5 GB with the light set.
# To grade what students handed in, without a network and without anything else of yours in reach:
#     mkdir -p graded      (Docker would make it as root's, and the ordinary user could not write there)
#     docker run --rm --network none -v "$PWD/submitted:/submitted:ro" -v "$PWD/graded:/graded" ditr_lite \
#         python tools/grade.py /submitted --csv /graded/grades.csv
FROM python:3.12-slim

ARG SET=environment-class.txt
# Where PyTorch publishes builds without CUDA; a plain pip would take one with it, 4 GB larger.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu

# An ordinary user, whose number is that of most people's own, so that mounted folders can be written.
RUN useradd --create-home --uid 1000 learner
WORKDIR /home/learner/ditr_lite
RUN chown learner:learner .
USER 1000
ENV PATH=/home/learner/venv/bin:$PATH OMP_NUM_THREADS=2 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1

# The packages before the code: a change of the code does not install them again.
COPY --chown=learner:learner environment.txt environment-class.txt ./
RUN python -m venv /home/learner/venv \
    && pip install --no-compile --index-url "$TORCH_INDEX" "$(grep '^torch==' environment.txt)" \
    && grep -v '^-e' "$SET" > /tmp/wanted.txt \
    && pip install --no-compile -r /tmp/wanted.txt "setuptools>=77"

COPY --chown=learner:learner . .
RUN pip install --no-deps --no-build-isolation -e . \
    && cp -r tools/labextensions /home/learner/venv/share/jupyter/

EXPOSE 8888
# 0.0.0.0 is inside the container; who may come in is said by -p. JupyterLab makes a token and prints it.
CMD ["python", "-m", "jupyterlab", "--ip=0.0.0.0", "--port=8888", "--no-browser", "--notebook-dir=.", "notebooks/00_start_here.ipynb"]
