"""A plain zenoh session with its own settings, which uses none of presage's code, as an attacker would.

`python intruder.py SETTINGS [ACTION...]`, both JSON. Prints `let in` or `not let in`, then the result of each action:
["put", KEY, HEX], ["get", KEY, HEX], ["serve", KEY, HEX] (answers until the process is ended).
"""

import json
import sys
import time

import zenoh


def main() -> None:
    config = zenoh.Config()
    for key, value in json.loads(sys.argv[1]).items():
        config.insert_json5(key, json.dumps(value))
    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        print("not let in")
        return
    print("let in", flush=True)
    for text in sys.argv[2:]:
        what, key, *rest = json.loads(text)
        if what == "put":
            publisher = session.declare_publisher(key)
            # Without waiting for a matching subscriber; the first put may be sent before the route is established.
            for _ in range(5):
                publisher.put(bytes.fromhex(rest[0]))
                session.put(key, bytes.fromhex(rest[0]))
                time.sleep(0.1)
            print("put", key, flush=True)
        elif what == "get":
            answers = list(session.get(key, payload=bytes.fromhex(rest[0]), timeout=1.0))
            print("answers", sum(1 for answer in answers if answer.ok is not None), flush=True)
        else:
            with session.declare_queryable(key) as queries:
                print("serving", flush=True)
                for query in queries:
                    query.reply(str(query.key_expr), bytes.fromhex(rest[0]))
                    query.drop()
    session.close()
    print("done", flush=True)


if __name__ == "__main__":
    main()
