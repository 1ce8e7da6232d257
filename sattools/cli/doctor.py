"""`sattools doctor`: is everything there that the suite can use?"""

from __future__ import annotations

import json

import click

from sattools.errors import SattoolsError


@click.command("doctor")
@click.option("--json", "as_json", is_flag=True, help="Print what was found as JSON.")
@click.option(
    "--fetch-geoids", is_flag=True, help="First download the EGM96 and EGM2008 grids that `export --vertical` needs."
)
@click.option(
    "--try",
    "trial",
    is_flag=True,
    help="Also take a small simulated scene through every step. This compiles what a first run would wait for, so "
    "installation is the time for it.",
)
@click.option(
    "--slim",
    is_flag=True,
    help="First remove from PyTorch what only those who develop or compile for it need, its test programs and headers "
    "(0.18 GB). For an environment of sattools alone: `make` and the Docker image do it.",
)
def command(as_json: bool, fetch_geoids: bool, trial: bool, slim: bool) -> None:
    """Say what is installed, what is missing and what to do about it; status 1 where the suite cannot work."""
    from sattools import doctor

    if slim:
        _slim_down()
    if fetch_geoids:
        doctor.fetch_geoids(lambda text: click.echo(text, err=True))
    findings = doctor.examine()
    if trial:
        findings.append(doctor.try_out(lambda text: click.echo(text, err=True)))
    if as_json:
        click.echo(json.dumps([finding.to_dict() for finding in findings], indent=1))
    else:
        width = max(len(finding.name) for finding in findings)
        for finding in findings:
            click.echo(f"{finding.state:8s}{finding.name:{width}s}  {finding.text}")
            if finding.remedy and finding.state != "ok":
                click.echo(f"{'':8s}{'':{width}s}  -> {finding.remedy}")
    if any(finding.state == "missing" for finding in findings):
        raise SystemExit(1)


def _slim_down() -> None:
    """Leave out of PyTorch what is for its developers, and say how much that was."""
    import importlib.metadata

    from sattools.slim import leave_out

    try:
        removed = leave_out(importlib.metadata.distribution("torch"))
    except importlib.metadata.PackageNotFoundError:
        raise SattoolsError("torch: found no installation of it, expected one") from None
    click.echo(f"removed {removed / 1e9:.2f} GB from PyTorch", err=True)
