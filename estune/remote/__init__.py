"""Rigs over the network: state machine, messages, Zenoh transport, ledger."""
