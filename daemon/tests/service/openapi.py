"""Checks the answers of the service against its OpenAPI document with independent validators.

    openapi.py URL

Before the check, every object of the document is closed and each of its fields is required. Both an additional and a missing
field then fail.
"""

import copy
import json
import sys
import time
import urllib.error
import urllib.request

from jsonschema import Draft202012Validator
from openapi_spec_validator import validate

URL = sys.argv[1]


def ask(method, path, body=None):
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(URL + path, data, {"Content-Type": "application/json"}, method=method.upper())
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, answer.headers.get_content_type(), answer.read(1_000_000 if "events" not in path else 500)
    except urllib.error.HTTPError as refused:
        return refused.code, refused.headers.get_content_type(), refused.read()


def closed(schema):
    if isinstance(schema, dict):
        schema = {key: closed(value) for key, value in schema.items()}
        if isinstance(schema.get("properties"), dict) and "type" in schema:
            schema["additionalProperties"] = False
            schema["required"] = list(schema["properties"])
    elif isinstance(schema, list):
        schema = [closed(value) for value in schema]
    return schema


status, _, text = ask("get", "/api/openapi.json")
assert status == 200
document = json.loads(text)
validate(document)
strict = closed(copy.deepcopy(document))


def holds(schema, answer, where):
    schema = {"$ref": "#/schema", "schema": schema, "components": strict["components"]}
    errors = [f"{error.json_path}: {error.message}" for error in Draft202012Validator(schema).iter_errors(answer)]
    assert not errors, f"{where}: {errors}"


BODIES = {
    "/api/start": dict.fromkeys(["operator", "robot", "bar", "payload", "note"], "A")
    | {"name": "described", "duration_s": None, "reason": "a test"},
    "/api/mark": {"text": "here", "ago_ms": 0},
    "/api/stop": {"cause": "enough"},
    "/api/home": {},
    "/api/note": {"name": "described", "note": "B"},
    "/api/name": {"name": "", "robot": "IRB 2400", "bar": "short"},
    "/api/pair": {},
    "/api/delete": {"name": "described"},
    "/api/restore": {"name": "described"},
    "/api/bin/empty": {},
}
# A run must be started before requests about it, and is deleted last.
ORDER = ["/api/start", "/api/mark", "/api/status", "/api/live", "/api/stop"]
LAST = ["/api/home", "/api/delete", "/api/restore", "/api/bin/empty"]
paths = [path for path in document["paths"] if path not in ORDER + LAST]
for path in ORDER + paths + LAST:
    for method, operation in strict["paths"][path].items():
        where = f"{method} {path}"
        body = BODIES.get(path)
        assert ("requestBody" in operation) == (body is not None), where
        if body is not None:
            holds(operation["requestBody"]["content"]["application/json"]["schema"], body, where)
        status, media_type, text = ask(method, path.replace("{name}", "described"), body)
        assert status == 200, f"{where}: {status} {text}"
        content = operation["responses"]["200"]["content"]
        assert list(content) == [media_type], f"{where}: {media_type}"
        if "schema" in content[media_type]:
            holds(content[media_type]["schema"], json.loads(text), where)
    if path == "/api/start":
        # Waits until the first cycles are on disk.
        time.sleep(2.5)
status, _, text = ask("post", "/api/mark", {"text": ""})
assert status == 422
holds({"$ref": "#/components/schemas/Refusal"}, json.loads(text), "a refusal")
print(f"{len(document['paths'])} paths hold")
