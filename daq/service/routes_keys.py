"""API keys over HTTP, for the scope `admin`: list, make (the text is shown once), revoke."""

from datetime import timedelta

from fastapi import APIRouter

from daq.service import wire
from daq.service.keys import InvalidKey, Key, utc_now
from daq.service.problems import Problem, not_found
from daq.service.state import Admin, Parts
from daq.service.wire import KeyRequest, NewKey

router = APIRouter(tags=["keys"])


def shown(key: Key) -> wire.Key:
    """A key as the API shows it: without its hash."""
    return wire.Key(
        id=key.id,
        name=key.name,
        scopes=list(key.scopes),
        created=key.created,
        expires=key.expires,
        state=key.state(utc_now()),
    )


@router.get("/keys")
def keys(service: Parts, who: Admin) -> list[wire.Key]:
    """Every key, oldest first; their texts are not kept."""
    return [shown(key) for key in service.keys.all()]


@router.post("/keys", status_code=201)
def create(body: KeyRequest, service: Parts, who: Admin) -> NewKey:
    """Make a key. Its text is in this answer and nowhere else."""
    valid_for = None if body.expires_days is None else timedelta(days=body.expires_days)
    try:
        key, text = service.keys.create(body.name, body.scopes, valid_for)
    except InvalidKey as error:
        raise Problem(422, "key", str(error)) from error
    service.audit.record(who.name, "create key", key.id, name=key.name, scopes=key.scopes)
    return NewKey(**shown(key).model_dump(), key=text)


@router.delete("/keys/{key}")
def revoke(key: str, service: Parts, who: Admin) -> wire.Key:
    """End a key at once; it stays in the list, so that the audit trail keeps its name."""
    try:
        revoked = service.keys.revoke(key)
    except InvalidKey as error:
        raise not_found("key", key) from error
    service.audit.record(who.name, "revoke key", key, name=revoked.name)
    return shown(revoked)
