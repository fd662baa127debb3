// A client of another make (node-opcua): reads a value with its status, time, unit and range, waits for an alarm, acknowledges
// it and comments on it.
// Arguments: address, user, password. Prints "listening" when it waits for the alarm, then one line of JSON.
"use strict";
const say = (line) => process.stdout.write(`${line}\n`);
console.log = console.warn = console.error; // the library warns about this version of Node.js
const opcua = require("node-opcua-client");
const { AttributeIds, OPCUAClient, MessageSecurityMode, SecurityPolicy, UserTokenType } = opcua;
const [url, userName, password] = process.argv.slice(2);
const NAMESPACE = "urn:panelwright:bench:panel";
const FIELDS = ["EventId", "ConditionName", "Message", "Severity", "ActiveState.Id", "AckedState.Id"];

async function main() {
    const client = OPCUAClient.create({
        endpointMustExist: false,
        securityMode: MessageSecurityMode.None,
        securityPolicy: SecurityPolicy.None,
        connectionStrategy: { maxRetry: 3, initialDelay: 50, maxDelay: 500 },
    });
    await client.connect(url);
    const session = await client.createSession({ type: UserTokenType.UserName, userName, password });
    const index = (await session.readNamespaceArray()).indexOf(NAMESPACE);
    const read = (path) => session.read({ nodeId: `ns=${index};s=${path}`, attributeId: AttributeIds.Value });
    const value = await read("pressure.value");
    const refused = await read("temperature.value");
    const unit = await read("pressure.value.EngineeringUnits");
    const range = await read("pressure.value.EURange");

    const subscription = await session.createSubscription2({
        requestedPublishingInterval: 50, requestedLifetimeCount: 1000, requestedMaxKeepAliveCount: 20, publishingEnabled: true,
        maxNotificationsPerPublish: 100,
    });
    const filter = opcua.constructEventFilter([...FIELDS, "ConditionId"],
        opcua.ofType("AlarmConditionType"));
    const item = await subscription.monitor(
        { nodeId: "i=2253", attributeId: AttributeIds.EventNotifier },
        { filter, queueSize: 100, discardOldest: true, samplingInterval: 0 },
        opcua.TimestampsToReturn.Both);
    const got = [];
    let wake = () => {};
    item.on("changed", (fields) => {
        got.push(fields);
        wake();
    });
    const next = async () => {
        while (got.length === 0) await new Promise((resolve) => { wake = resolve; });
        return got.shift().map((one) => one.value);
    };
    say("listening");
    const [eventId, name, message, severity, active, acknowledged] = await next();
    const status = await session.acknowledgeCondition(`ns=${index};s=${name}`, eventId, "seen by node-opcua");
    if (!status.isGood()) throw new Error(`Acknowledge: ${status.toString()}`);
    const after = await next();
    const commented = await session.addCommentCondition(`ns=${index};s=${name}`, after[0], "said by node-opcua");
    if (!commented.isGood()) throw new Error(`AddComment: ${commented.toString()}`);
    say(JSON.stringify({
        value: { value: value.value.value, status: value.statusCode.name, at: value.sourceTimestamp.getTime() },
        refused: { value: refused.value.value ?? null, status: refused.statusCode.name },
        unit: unit.value.value.displayName.text,
        range: [range.value.value.low, range.value.value.high],
        event: { name, message: message.text, severity, active, acknowledged },
        after: { active: after[4], acknowledged: after[5] },
    }));
    await subscription.terminate();
    await session.close();
    await client.disconnect();
}

main().then(() => process.exit(0), (error) => {
    console.error(error);
    process.exit(1);
});
