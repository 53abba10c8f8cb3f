"""The agent: the programs that run on a measured or deployed machine.

It imports nothing else of fogspec and needs Python 3.10 with the standard library alone. It is shipped as one file,
`compiled/agent.pyz` (`fogspec.compile.agent_archive`), in which this package is named `fogspec_agent`.
"""
