"""Checks the rights of a client on another machine. The client uses the TLS implementation of Python.

usage: remote.py PORT STATE WORDS

STATE is the directory with certificate and token. WORDS is the address line of the service. A failed check ends with an error.
"""

import hashlib
import http.client
import json
import socket
import ssl
import sys
from pathlib import Path

port, state, words = int(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
token = (state / "token").read_text()
# Verifies the certificate and its name.
trusting = ssl.create_default_context(cafile=state / "certificate.pem")


class Connection(http.client.HTTPSConnection):
    def connect(self):
        raw = socket.create_connection(("127.0.0.1", port), timeout=20)
        self.sock = trusting.wrap_socket(raw, server_hostname="ballbard")


def asked(path="/api/status", method="GET", body=None, **headers):
    connection = Connection("ballbard", port)
    connection.request(method, path, body=body, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    return answer.status, answer.headers, answer.read().decode()


bearer = f"Bearer {token}"
with socket.create_connection(("127.0.0.1", port)) as raw, trusting.wrap_socket(raw, server_hostname="ballbard") as tls:
    assert tls.version() == "TLSv1.3", tls.version()
    digest = hashlib.sha256(tls.getpeercert(binary_form=True)).hexdigest()
    assert ":".join(digest[at:at + 2] for at in range(0, 64, 2)) in words, words

# Sends the right token in each permitted form.
status, _, said = asked(Authorization=bearer)
assert status == 200 and json.loads(said)["state"] == "waiting", said
status, headers, _ = asked(f"/?token={token}")
cookie = headers["Set-Cookie"]
assert status == 200 and headers["Refresh"] == "0; url=/", headers
for word in ["HttpOnly", "Secure", "SameSite=Strict", "Path=/", "__Host-"]:
    assert word in cookie, cookie
status, _, said = asked("/", Cookie="other=1; " + cookie.split(";")[0])
assert status == 200 and "app.js" in said, said
own = f"https://ballbard:{port}"
status, _, said = asked("/api/stop", "POST", "{}", Cookie=cookie.split(";")[0], Origin=own, Content_Type="application/json")
assert status == 200, said

# The code for a phone works only once, and only for the page.
status, _, said = asked("/api/pair", "POST", "{}", Authorization=bearer, Content_Type="application/json")
pairing = json.loads(said)
assert status == 200 and pairing["fingerprint"] in words and "<svg" in pairing["links"][0]["svg"], said
link = pairing["links"][0]["url"]
assert link.startswith(f"https://127.0.0.1:{port}/?pair=") and token not in said, said
code = link.split("=")[1]
assert asked(f"/api/status?pair={code}")[0] == 401 and asked(f"/?pair={code[1:]}")[0] == 401
status, headers, _ = asked(f"/?pair={code}")
assert status == 200 and headers["Set-Cookie"] == cookie and headers["Refresh"] == "0; url=/", headers
assert asked(f"/?pair={code}")[0] == 401

# The OpenAPI document must describe the same forms of the token.
document = json.loads(asked("/api/openapi.json", Authorization=bearer)[2])
schemes = document["components"]["securitySchemes"]
assert {} in document["security"] and "--listen" in document["info"]["description"], document["info"]
assert all(set(names) <= set(schemes) for names in document["security"])
assert (schemes["token"]["type"], schemes["token"]["scheme"]) == ("http", "bearer")
browser = schemes["browser"]
assert (browser["type"], browser["in"]) == ("apiKey", "cookie") and cookie.startswith(browser["name"] + "="), browser

# Without a token, nothing is accessible: no page, no file of the page, no data and no action.
for method, path in [("GET", "/api/status"), ("GET", "/api/events"), ("GET", "/metrics"), ("GET", "/app.js"),
                     ("GET", "/api/runs/x/mcap"), ("POST", "/api/start"), ("POST", "/api/delete"), ("POST", "/api/pair"),
                     ("GET", "/nowhere")]:
    status, headers, said = asked(path, method, "{}" if method == "POST" else None, Content_Type="application/json")
    assert status == 401 and headers["WWW-Authenticate"] == "Bearer", (path, status)
    assert "missing" in said and "Bearer TOKEN" in said, said
status, _, said = asked("/")
assert status == 401 and "<form" in said and "missing" in said, said

# Requests with the right token are refused if they have a foreign origin or two Host headers.
assert asked(Authorization=bearer, Origin="https://evil.example")[0] == 403
assert asked(Authorization=bearer, Origin=own.replace("https", "http"))[0] == 403
twice = Connection("ballbard", port)
twice.putrequest("GET", "/api/status")
twice.putheader("Host", "evil.example")
twice.putheader("Authorization", bearer)
twice.endheaders()
assert twice.getresponse().status in (400, 403)

# Each wrong token is refused. After too many wrong tokens the client must wait, but the right token still works.
wrong = [token[:-1], token + "0", token[:-1] + ("1" if token[-1] == "0" else "0"), token.upper() + "x", "a" * 4000]
for attempt in wrong:
    status, _, said = asked(Authorization=f"Bearer {attempt}")
    assert status == 401 and "wrong" in said and "Bearer TOKEN" in said, (attempt, status, said)
assert asked(f"/?token={wrong[0]}")[0] == 401
assert asked(Cookie=f"__Host-ballbard={wrong[0]}")[0] == 401
assert asked("/api/status?token=" + token)[0] == 401
told = [asked(Authorization="Bearer x")[0] for _ in range(8)]
assert told[0] == 401 and told[-1] == 429, told
assert asked(Authorization=bearer)[0] == 200

# A client without TLS gets no data, and neither does a client that sends nothing.
with socket.create_connection(("127.0.0.1", port), timeout=20) as plain:
    plain.sendall(b"GET /api/status HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    assert b"HTTP" not in plain.recv(4096)
with socket.create_connection(("127.0.0.1", port), timeout=20) as silent:
    assert silent.recv(1) == b"", "a silent client is disconnected"
