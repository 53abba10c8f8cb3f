"""The agent: the programs that run on a measured or deployed machine.

It imports nothing else of fogspec and needs Python 3.10 with the standard library alone. It is shipped as one file,
`compiled/agent.pyz` (`fogspec.compile.agent_archive`), in which this package is named `fogspec_agent`.
"""

# Of what a deployed agent reads and writes: options, files in its output, its answers. Raise it when a machine that runs the
# agent of before would not do: only then does a new version of fogspec replace what runs.
PROTOCOL = 1
