"""Communication layer that drivers are built on: links, framing, requests and answers, owner threads, mailboxes."""
