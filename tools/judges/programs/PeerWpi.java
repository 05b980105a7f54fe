// A peer on OpenIGTLink-Java (WPI) that sends what its standard input has and prints what it receives: foreign_peers.py.

import java.io.BufferedReader;
import java.io.InputStreamReader;
import java.net.URLDecoder;
import java.net.URLEncoder;
import java.nio.charset.StandardCharsets;
import java.util.ArrayList;
import java.util.Arrays;

import com.neuronrobotics.sdk.addons.kinematics.math.RotationNR;
import com.neuronrobotics.sdk.addons.kinematics.math.TransformNR;
import org.medcare.igtl.messages.CapabilityMessage;
import org.medcare.igtl.messages.ImageMessage;
import org.medcare.igtl.messages.NDArrayMessage;
import org.medcare.igtl.messages.OpenIGTMessage;
import org.medcare.igtl.messages.PositionMessage;
import org.medcare.igtl.messages.StatusMessage;
import org.medcare.igtl.messages.StringMessage;
import org.medcare.igtl.messages.TransformMessage;
import org.medcare.igtl.network.GenericIGTLinkClient;
import org.medcare.igtl.network.GenericIGTLinkServer;
import org.medcare.igtl.network.IOpenIgtPacketListener;
import org.medcare.igtl.util.Status;

public class PeerWpi implements IOpenIgtPacketListener {
    interface Sender {
        void send(OpenIGTMessage message) throws Exception;
    }

    public static void main(String[] arguments) throws Exception {
        Sender sender;
        if (arguments[0].equals("client")) {
            GenericIGTLinkClient client = new GenericIGTLinkClient(arguments[1], Integer.parseInt(arguments[2]));
            client.addIOpenIgtOnPacket(new PeerWpi());
            sender = client::sendMessage;
        } else {
            GenericIGTLinkServer server = new GenericIGTLinkServer(Integer.parseInt(arguments[1]));
            server.addIOpenIgtOnPacket(new PeerWpi());
            sender = server::sendMessage;
        }
        System.out.println("ready");
        BufferedReader input = new BufferedReader(new InputStreamReader(System.in, StandardCharsets.UTF_8));
        for (String line = input.readLine(); line != null; line = input.readLine()) {
            try {
                String[] words = line.split(" ");
                OpenIGTMessage message = made(words[0], text(words[1]), words);
                message.PackBody();
                sender.send(message);
            } catch (Exception error) {
                System.out.println("error =" + URLEncoder.encode(error.toString(), "UTF-8"));
            }
        }
        System.exit(0);
    }

    // words: type, device, stamp in ns, then those of the content

    static OpenIGTMessage made(String type, String device, String[] words) throws Exception {
        switch (type) {
            case "TRANSFORM": return new TransformMessage(device, doubles(words, 12, 15), rows(words, 3));
            case "POSITION": {
                double[] q = doubles(words, 6, 10);
                return new PositionMessage(device, doubles(words, 3, 6), new RotationNR(q[3], q[0], q[1], q[2]));
            }
            case "STRING": return new StringMessage(device, text(words[3]));
            case "STATUS": return new StatusMessage(device, number(words[3]), number(words[4]), text(words[5]), text(words[6]));
            case "IMAGE": {
                long[] size = {number(words[3]), number(words[4]), number(words[5])};
                ImageMessage message = new ImageMessage(device);
                message.setImageHeader(1, number(words[7]), number(words[6]), ImageMessage.ENDIAN_LITTLE, ImageMessage.COORDINATE_RAS,
                    size, doubles(words, 19, 22), rows(words, 10), new long[3], size);
                message.setImageData(bytes(words[22]));
                return message;
            }
            case "NDARRAY": {
                double[] given = doubles(words, 5, words.length);
                float[] values = new float[given.length];
                for (int i = 0; i < values.length; i++) values[i] = (float) given[i];
                return new NDArrayMessage(device, values);
            }
            case "CAPABILITY": {
                ArrayList<String> names = new ArrayList<>();
                for (String word : Arrays.asList(words).subList(3, words.length)) names.add(text(word));
                CapabilityMessage message = new CapabilityMessage(device);
                message.SetCapabilityData(names);
                return message;
            }
            default: throw new IllegalArgumentException("no class for " + type);
        }
    }

    // what arrives

    public void onRxTransform(String name, TransformNR got) {
        StringBuilder words = new StringBuilder();
        for (int column = 0; column < 3; column++) for (int row = 0; row < 3; row++) words.append(got.getRotationMatrixArray()[row][column]).append(' ');
        print("TRANSFORM", name, words + joined(got.getPositionArray()));
    }

    public void onRxString(String name, String body) { print("STRING", name, quoted(body)); }

    public void onRxImage(String name, ImageMessage image) {
        StringBuilder hex = new StringBuilder("=");
        for (byte each : image.getImageData()) hex.append(String.format("%02x", each));
        long[] size = image.getDimensions();
        print("IMAGE", name, size[0] + " " + size[1] + " " + size[2] + " " + image.getScalarType() + " " + image.getImageType() + " " + image.getEndian() + " 1 "
            + "0 0 0 0 0 0 0 0 0 0 0 0 " + hex);
    }

    public void onRxNDArray(String name, float[] data) {
        StringBuilder words = new StringBuilder();
        for (float each : data) words.append(each).append(' ');
        print("NDARRAY", name, words.toString().trim());
    }

    public TransformNR getTxTransform(String name) { return new TransformNR(); }
    public Status onGetStatus(String name) { return new Status(1); }
    public String onTxString(String name) { return ""; }
    public void onRxDataArray(String name, Jama.Matrix data) { }
    public double[] onTxDataArray(String name) { return new double[0]; }
    public void onTxNDArray(String name) { }

    static synchronized void print(String type, String device, String words) {
        System.out.println(type + " " + quoted(device) + " 0 0 0 " + words);
    }

    static String joined(double[] values) {
        StringBuilder words = new StringBuilder();
        for (double each : values) words.append(words.length() > 0 ? " " : "").append(each);
        return words.toString();
    }

    static int number(String word) { return (int) Long.parseLong(word); }

    static double[] doubles(String[] words, int from, int to) {
        double[] values = new double[to - from];
        for (int i = 0; i < values.length; i++) values[i] = Double.parseDouble(words[from + i]);
        return values;
    }

    static double[][] rows(String[] words, int from) {  // the words have columns
        double[][] matrix = new double[3][3];
        for (int i = 0; i < 9; i++) matrix[i % 3][i / 3] = Double.parseDouble(words[from + i]);
        return matrix;
    }

    static byte[] bytes(String word) {
        byte[] found = new byte[(word.length() - 1) / 2];
        for (int i = 0; i < found.length; i++) found[i] = (byte) Integer.parseInt(word.substring(1 + 2 * i, 3 + 2 * i), 16);
        return found;
    }

    static String text(String word) throws Exception { return URLDecoder.decode(word.substring(1), "UTF-8"); }

    static String quoted(String text) {
        return "=" + URLEncoder.encode(text == null ? "" : text, StandardCharsets.UTF_8).replace("+", "%20");
    }
}
