"""What a route does not ask for is refused, wherever it comes: in the query as in the body."""

from collections.abc import Iterator

from fastapi import Request
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from starlette.requests import HTTPConnection

from daq.service.problems import Problem


def _names(dependant: Dependant) -> Iterator[str]:
    yield from (field.alias for field in dependant.query_params)
    for one in dependant.dependencies:
        yield from _names(one)


async def only_asked(connection: HTTPConnection) -> None:
    """Refuse with 422 parameters, and a body, that the route would pass over in silence."""
    route = connection.scope["route"]
    if not isinstance(connection, Request) or not isinstance(route, APIRoute):
        return
    known = tuple(_names(route.dependant))
    for name in connection.query_params:
        if name not in known and name != "ticket":  # which the guard has taken
            there = f"there are {', '.join(known)}" if known else "there are none"
            raise Problem(
                422, "validation", f"query parameter {name[:100]!r} is not known here; {there}"
            )
    takes_body = route.body_field is not None or "requestBody" in (route.openapi_extra or {})
    if not takes_body and (await connection.body()).strip() not in (b"", b"{}", b"null"):
        raise Problem(422, "validation", "body: this request takes none: leave it out")
