#!/bin/sh
# Makes the secrets of compose.yaml: a password for PostgreSQL, and the address of the database that holds it.
# The folder keeps others out; the files themselves must be readable for the accounts inside the containers.
set -eu
cd "$(dirname "$0")"
if [ -e secrets ]; then
    echo "error: $(pwd)/secrets is there already; remove it first (the database keeps its old password)" >&2
    exit 2
fi
umask 077
mkdir secrets
password=$(od -An -N24 -tx1 /dev/urandom | tr -d ' \n')
printf '%s' "$password" > secrets/postgres_password
printf 'postgresql://causticmill:%s@postgres/causticmill' "$password" > secrets/causticmill_database_url
chmod 0444 secrets/postgres_password secrets/causticmill_database_url
echo "made: $(pwd)/secrets"
