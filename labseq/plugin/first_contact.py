"""Steps that test a driver's assumptions about its device, and the file with their results."""

from __future__ import annotations

from labseq.drivers.first_contact import (
    check_belongs,
    contact_path,
    read_contact,
)
from labseq.files import data_root
from labseq.roles.first_contact import ContactStep, FirstContact, OffersFirstContact, Reading

__all__ = [
    "ContactStep",
    "FirstContact",
    "OffersFirstContact",
    "Reading",
    "check_belongs",
    "contact_path",
    "data_root",
    "read_contact",
]
